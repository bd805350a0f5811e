"""Rigid motions of the plane and the alignments of point sets."""
