"""Files of any program: written whole or not at all, read without believing what they claim, told without obeying what they say."""
