"""What a reader sees of an evaluation: its files, plots, contact sheets and the web page."""
