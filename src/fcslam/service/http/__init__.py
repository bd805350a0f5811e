"""The service over HTTP: routes for robots, viewers and administrators, and their authentication."""
