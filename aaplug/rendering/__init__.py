"""From a prepared scene to images: the renderer, many frames, and pools of workers."""
