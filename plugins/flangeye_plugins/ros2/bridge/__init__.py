"""The bridge process, in its own folder so that its Python imports no other module."""
