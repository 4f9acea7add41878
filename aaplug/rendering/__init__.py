"""From a prepared scene to images: the renderer, many frames, videos, and pools of workers."""
