"""Places: vocabulary, index, similarity and how two places lie to each other."""
