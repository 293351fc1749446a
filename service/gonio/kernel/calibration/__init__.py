"""Camera calibration and the lab frame."""
