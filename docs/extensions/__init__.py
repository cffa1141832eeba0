"""What the manual needs of Sphinx besides its own extensions."""
