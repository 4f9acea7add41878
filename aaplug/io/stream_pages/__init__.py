"""Pages that open streamed levels: each reads settings.json and the index beside it, and the viewer from viewer/."""
