"""The SDK's own parts. Users import public names from `tensormass`; nothing here is promised to stay."""
