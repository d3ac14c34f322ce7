// Sums of entries of walls, behind those of others.
const double found[COLUMNS] = {RESIDUAL ? residual : 0, 0, 0, es, ee, ss, 0, residual};
for (int c = 0; c < COLUMNS; ++c) partials[c*(long long)(given.partials.shape[0]/COLUMNS) + behind + c_] = found[c];
