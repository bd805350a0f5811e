"""Rigid motions of the plane and of space, alignments of points, and the geometry of beams, cells and voxels."""
