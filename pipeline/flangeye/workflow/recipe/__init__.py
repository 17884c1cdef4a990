"""From a YAML recipe to checked steps: header, steps, overrides, JSON Schema."""
