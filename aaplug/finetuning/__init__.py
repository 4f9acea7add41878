"""Fine-tuning at test time: move the Gaussians until every scale looks like the training size."""
