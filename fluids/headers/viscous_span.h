// Where the unknowns of each row begin and end, and its core: the longest run of cells whose equations are those of the cells beside them.
// Into `ends` how long the runs are that touch the row's two ends.
const float* fields[3] = {dx, dy, dz};
const long long beside[3] = {1, s2, s1};
int begin = (int)s2, end = 0, run = 0, length = 0, core = 0, head = 0;
for (int i = first; i < last; ++i) {
    bool there = false, alike = true;
    for (int a = 0; a < (dz ? 3 : 2); ++a) {
        const float* d = fields[a] + i;
        there = there || *d > 0.0f;
        for (int b = 0; b < (dz ? 3 : 2); ++b) {
            alike = alike && *d > 0.0f && fabsf(d[beside[b]] - *d) <= ALIKE*(*d) && fabsf(d[-beside[b]] - *d) <= ALIKE*(*d);
        }
    }
    if (there) { begin = i < begin ? i : begin; end = i + 1; }
    run = alike ? run + 1 : 0;
    if (run > length) { length = run; core = i + 1; }
    if (run == i + 1 - first) head = run;
}
int* row = span + 4*(k*(int)(s1/s2) + j);
row[0] = begin; row[1] = end; row[2] = length ? core - length : end; row[3] = length ? core : end;
if (ends) { ends[2*(k*(int)(s1/s2) + j)] = head; ends[2*(k*(int)(s1/s2) + j) + 1] = run; }
