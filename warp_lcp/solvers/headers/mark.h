const S mark = (S)1e30f;  // in place of a right-hand side, of order one: a held unknown that is not at its bound, below 0 for the lower one
