"""What is known about a building places its maps: a floor plan, fixes of satellite navigation."""
