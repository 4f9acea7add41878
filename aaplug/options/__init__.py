"""Options of the verbs, stated once: a field is a verb's keyword, and its docstring the command line's help.

Importing them takes no torch, so that help and mistakes on the command line are answered at once.
"""
