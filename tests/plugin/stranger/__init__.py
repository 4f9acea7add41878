"""A plug-in of aaplug: one file for each kind of thing that can be added."""
