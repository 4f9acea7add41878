"""Measurements: heavy, never part of the tests."""
