"""A controller of AUBO (ARCS), as the pyaubo-sdk client library (0.24) knows it.

Port: JSON-RPC 30004. The methods that move and tell are there; programs, inputs and outputs are
not. What the library sends was recorded from it; how a real controller answers is from the maker's
documentation of the interface, and where that is silent the README of the drivers says so.
"""
