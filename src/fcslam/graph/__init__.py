"""The pose graph: variables and measured motions, robust optimisation, consistency of closures, g2o files."""
