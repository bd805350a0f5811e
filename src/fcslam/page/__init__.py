"""The web page of the live map."""
