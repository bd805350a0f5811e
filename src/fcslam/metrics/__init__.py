"""Pure measures of results against references."""
