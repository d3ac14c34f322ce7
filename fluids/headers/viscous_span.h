// Where the unknowns of each row begin and end.
int begin = (int)s2, end = 0;
for (int i = first; i < last; ++i) if (dx[i] > 0.0f || dy[i] > 0.0f || (dz && dz[i] > 0.0f)) { begin = i < begin ? i : begin; end = i + 1; }
span[2*(k*(int)(s1/s2) + j)] = begin; span[2*(k*(int)(s1/s2) + j) + 1] = end;
