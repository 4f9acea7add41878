"""Measuring images against a truth: protocols, metrics, the engine, its journal and its reports."""
