"""The reports of an evaluation: its files, plots, contact sheets and the web page."""
