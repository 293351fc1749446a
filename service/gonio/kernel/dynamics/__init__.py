"""Inverse dynamics: the forces behind a motion."""
