"""Median filter, zero-lag low-pass and gaps: smoothing that never invents data."""
