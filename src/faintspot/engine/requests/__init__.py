"""Requests to a running engine (`requests`, `private_socket`), its priority and its child processes."""
