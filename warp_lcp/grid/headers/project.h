// Where the distance on a grid has a saddle, as in the edge between two walls along the grid, Newton's method along the gradient goes
// astray. There the direction is that of differences over a cell, and the way out is searched in short legs.
auto wide_normal = [&](const T* x, T* n) {
    for (int d = 0; d < 3; ++d) {
        T s[2] = {0, 0}, g[3];
        for (int side = 0; d <= planes && side < 2; ++side) {
            T y[3] = {x[0], x[1], x[2]};
            y[d] += side ? (T)0.5 : (T)-0.5;
            const T beyond = y[d];
            into_domain(y);
            s[side] = measure(y, g) - ((ENDLESS >> d & 1) ? (T)0 : beyond > y[d] ? beyond - y[d] : y[d] - beyond);
        }
        n[d] = s[1] - s[0];
    }
    const T size = sqrt(square(n));
    for (int d = 0; d < 3; ++d) n[d] = size > (T)1e-6 ? n[d]/size : (T)0;
    return size > (T)1e-6;
};
auto search = [&](T* x, T first_length, T limit) {
    T n[3], y[3], g[3];
    const T leg = (T)LEG;
    auto distance_along = [&](T c) {
        for (int d = 0; d < 3; ++d) y[d] = x[d] + c*n[d];
        into_domain(y);
        return measure(y, g);
    };
    for (T gone = 0; gone < limit; gone += leg) {
        if (!wide_normal(x, n)) return false;
        T inside = 0, open = 0;
        for (T c = first_length < leg ? first_length : leg; open == 0 && c < 2*leg; c *= 2) {
            const T at = c < leg ? c : leg;
            if (distance_along(at) >= aim) open = at; else inside = at;
        }
        for (int halving = 0; open > 0 && halving < 6; ++halving) {
            const T middle = (T)0.5*(inside + open);
            if (distance_along(middle) >= aim) open = middle; else inside = middle;
        }
        distance_along(open > 0 ? open : leg);
        for (int d = 0; d < 3; ++d) x[d] = y[d];
        if (open > 0) return true;
    }
    return false;
};
// Put a point that is too near or inside at the distance `aim`; n becomes the normal there. 0: no way out within the limit, 2: it was
// the gradient that led nowhere.
auto project = [&](T* x, T* n, T limit) {
    const T start[3] = {x[0], x[1], x[2]};
    T s = measure(x, n), far = 0;
    const T first_length = aim - s;
    for (int step = 0; step < 8 && s < margin && far <= limit*limit; ++step) {
        const T need = aim - s, steepness = square(n), trust = 4*need + (T)0.05;
        if (!(need*need <= steepness*trust*trust)) break;
        const T slope = sqrt(steepness), length = need/slope, most = need + (T)0.05;  // it is only here that the slope is not 1
        for (int d = 0; d < 3; ++d) x[d] += (length < most ? length : most)/slope*n[d];
        into_domain(x);
        s = measure(x, n);
        const T way[3] = {x[0] - start[0], x[1] - start[1], x[2] - start[2]};
        far = square(way);
    }
    int out = s >= margin && far <= limit*limit;
    if (!out) {
        for (int d = 0; d < 3; ++d) x[d] = start[d];
        out = search(x, first_length > margin ? first_length : margin, limit) ? 2 : 0;
        measure(x, n);
    }
    const T size = sqrt(square(n));
    for (int d = 0; d < 3; ++d) n[d] = size > 0 ? n[d]/size : (T)0;
    return out;
};
