"""Central, federated and local training compared."""
