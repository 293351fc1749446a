"""Transforms, cameras, lens distortion, projection."""
