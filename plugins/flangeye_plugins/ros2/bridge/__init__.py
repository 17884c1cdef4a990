"""In a folder of its own, so that the bridge's Python imports these modules and no others."""
