"""What the SDK shares with the gateway and the tools on purpose. No user imports it, so that any name here may change.

A module here imports none of `tensormass._src`, and knows the protocol at most. What users want too is public
(`tensormass.__all__`); the gateway and the tools take it from there.
"""
