"""The software of the cloud: it matches places, judges closures, and makes one pose graph and one map."""
