"""Floor below the scene: errors, registries, workers, locks, hashes, messages."""
