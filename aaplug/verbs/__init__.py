"""The verbs of the command line, each as one call of the library."""
