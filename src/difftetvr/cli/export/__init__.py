"""What can be written of a mesh: itself in another format, what it holds on a grid, the surface of a level?"""
