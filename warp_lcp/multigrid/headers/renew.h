// Clear what lies in a row's old span and not in its new one, and mark the row.
const auto old = known[P.row], now = spans[P.row];
if (old[0] != now[0] || old[1] != now[1]) {
    const auto clear = [&](auto* field) {
        if (field) for (int k = old[0]; k < old[1]; ++k) if (k < now[0] || k >= now[1]) field[k] = 0; };
    clear(x); clear(b); clear(t); clear(diagonals); clear(lower_x); clear(lower_y); clear(lower_z);
    known[P.row] = now; changed[P.row] = 1; }
