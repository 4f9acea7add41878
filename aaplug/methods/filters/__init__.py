"""Filters: of scenes in the world, and of splats on the screen; one method a file."""
