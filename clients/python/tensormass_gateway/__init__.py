"""The gateway between a daemon and browsers. Built on the SDK, which does not know it."""
