"""Text logs of CARMEN."""
