"""Methods for comparison: what the literature asks about and measurement showed to be no better than the defaults.

Nothing in aaplug imports this folder.  It adds its entries as any other package does, by entry points in
pyproject.toml.  `aaplug warmup --recipe NAME` compiles what a recipe of it needs; examples/guides/methods.md has
the figures.
"""
