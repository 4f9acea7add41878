"""What web viewers draw, against photographs and against what aaplug predicts."""
