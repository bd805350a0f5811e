"""Maps of several robots: fused from keyscans, drawn as pictures and figures, cut into tiles."""
