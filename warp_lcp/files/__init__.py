"""What readers of files believe: sizes that fit, arrays of plain numbers."""
