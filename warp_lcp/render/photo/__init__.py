"""Path-traced pictures of a run by Mitsuba 3. Needs the extra `photo`."""
