"""The demo: a public recording goes over HTTP through a running service to a gait report."""
