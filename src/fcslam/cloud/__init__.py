"""What runs in the cloud: places matched, closures judged, one pose graph, one map."""
