"""The tables, figures and reports of the evaluation commands, over the measures of ``fcslam.metrics``."""
