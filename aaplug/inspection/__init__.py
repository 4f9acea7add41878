"""What a scene is and how finely training sampled it."""
