"""Certificates that an answer is globally optimal."""
