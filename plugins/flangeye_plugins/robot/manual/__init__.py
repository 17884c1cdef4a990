"""An arm that a person moves: the program says where to, the person says where it stands."""
