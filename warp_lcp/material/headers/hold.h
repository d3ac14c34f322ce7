// Tell which trees reach a wall, and which have several cells: those without weight stay alone.
#include "trees.h"
int parent_of = -1, root = -1;
for (int i = first; i < last; ++i) {
    const int c = (int)(q + i), joined = P[c] != c, wall = (kind[i] == SOLID) | (touch[i] & TOUCHES);
    if (!(joined | wall)) continue;
    if (P[c] != parent_of) { parent_of = P[c]; root = find(c); }
    if (wall) held[root] = 1;
    if (joined) several[root] = 1;
}
