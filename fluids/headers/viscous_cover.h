// Faces in a wall that the pressure has moved, as a part of them is open, take the velocity of the wall that holds them.
SIMD for (int i = first; i < last; ++i) {
    const float speed = MOVING ? own[MOVING ? i : 0] : 0.0f;
    const bool stays = (hold[i] > 0.0f) & (h[i] < INFINITY);
    total[i] = stays ? speed - u[i] : total[i];
}
