"""Nouns (Gaussians, cameras, splats, training views) and the maths that every stage shares."""
