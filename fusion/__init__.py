"""Fusion: strapdown navigation and the error-state Kalman filter over GNSS, pose fixes and vehicle motion."""
