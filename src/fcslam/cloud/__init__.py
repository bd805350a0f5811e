"""The cloud: receives what the robots send, joins their maps, and writes the one map of the building."""
