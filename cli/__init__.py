"""The command line: one verb a file, each reading, calling the library and writing."""
