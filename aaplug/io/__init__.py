"""Everything that touches the disk: scenes, cameras, images, and the writing of whole files."""
