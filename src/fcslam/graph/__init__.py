"""The pose graph: variables and measured motions, robust optimization, consistency of closures, g2o files."""
