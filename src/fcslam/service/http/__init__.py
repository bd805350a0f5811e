"""The cloud over HTTP: what robots, viewers and administrators may ask, and of whom it is believed."""
