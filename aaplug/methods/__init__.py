"""Anti-aliasing methods: filters, pixel kernels, compositors, and the recipes that combine them."""
