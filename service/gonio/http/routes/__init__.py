"""One module per resource; each route only translates between HTTP and a use case of ``gonio.jobs.service``."""
