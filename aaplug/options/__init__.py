"""Options of the verbs, a module each, stated once: a field is a verb's keyword, its docstring the command line's help.

Importing them takes no torch, so that help and mistakes on the command line are answered at once.
"""
