"""Measuring images against a truth: protocols, metrics, the truth, the engine, its journal and its reports."""
