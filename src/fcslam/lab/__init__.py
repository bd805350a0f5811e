"""The laboratory: simulation, evaluation and the configuration of the paper."""
