// How much friction a wall bears under a load >= 0: mu times it (Coulomb), and no more than the sand beside it bears in simple shear, however
// fast: on a wall rougher than sand it is the sand that fails, in a band thinner than a cell. Without that bound a column of depth h that is
// pushed between walls a distance l apart loads itself by exp(2 mu h / l) (Janssen): walls that stick leave it no stress at all.
auto wall_bound = [&](float mu, auto load) {
    const auto wall = mu*load, sand = (numbers[FRICTION] + numbers[GAIN])*load + numbers[COHESION];
    return wall < sand ? wall : sand;
};
