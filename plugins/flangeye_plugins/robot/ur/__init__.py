"""Arms of Universal Robots: ``driver`` here, the client library in a process of its own."""
