"""Missions: what an offline run is, from recordings to a run folder, and what changes it afterwards."""
