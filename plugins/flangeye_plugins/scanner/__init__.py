"""Scanners: one module each, which imports its SDK only when it opens a device."""
