"""Maps of several robots: fused from their keyscans, drawn as pictures, cut into tiles."""
