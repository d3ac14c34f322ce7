// Faces in a wall that the pressure has moved, as a part of them is open, take the velocity of the wall that holds them.
const long long step = axis == 0 ? 1 : (axis == 1 ? s2 : s1);
SIMD for (int i = first; i < last; ++i) {
    const float speed = MOVING ? own[MOVING ? i : 0] : 0.0f;
    const bool source = ((kind[i] == SOLID) & (base[i] != SOLID)) | ((kind[i - step] == SOLID) & (base[i - step] != SOLID));
    const bool stays = (hold[i] > 0.0f) & (h[i] < INFINITY) & !source;
    total[i] = stays ? speed - u[i] : total[i];
}
