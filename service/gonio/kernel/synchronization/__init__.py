"""When each camera saw what: delays between the cameras, found from the subject's own movement."""
