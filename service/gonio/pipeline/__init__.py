"""The river, from capture to report. Nobody but this package knows the order of the stages."""
