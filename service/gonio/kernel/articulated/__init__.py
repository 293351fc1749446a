"""The motion of an articulated body's joints from a few pictures of one moving camera."""
