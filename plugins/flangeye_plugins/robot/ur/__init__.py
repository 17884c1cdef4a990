"""Arms of Universal Robots: ``driver`` in this process, the client library in another."""
