"""Arms of Universal Robots: the driver in this process, the client library in another."""
