"""The cloud as a service: what stores, isolates and exposes it, around the fleet of ``fcslam.cloud``."""
