"""Durable jobs, workers and the artefact store."""
