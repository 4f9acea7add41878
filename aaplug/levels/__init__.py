"""Levels of detail: fewer Gaussians that look the same at a lower sampling rate."""
