"""The HTTP service: FastAPI app, dependencies, schemas, the error table and the routes."""
