"""The bundled sample scene: a pretrained chair, its cameras and four test photographs (see ORIGIN.md)."""
