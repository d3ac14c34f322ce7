"""Images and films of a run. Needs the extra `render`."""
