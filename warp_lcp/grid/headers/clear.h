// Nothing.
for (int i = first; i < last; ++i) field[i] = 0;
