"""Text logs: CARMEN, CMU, DP-SLAM, CoreSLAM, csm."""
