"""The built-in scenes, as TOML files."""
