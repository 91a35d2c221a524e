/* Runs mcc_law.h over paths: records of doubles on standard input, {force, tangent, x_max} for every point on output.
 * A record: kind (0 plates, 1 wall, 2 pair), steps, law of i (C1 C3 C5 a E k n p), D1 D2 D3 of i, the same of j,
 * history at the start, path. */
#include <stdio.h>
#include <stdlib.h>

#include "mcc_law.h"

static mcc_law law_of(const double *v)
{
    mcc_law law;
    law.C1 = v[0];
    law.C3 = v[1];
    law.C5 = v[2];
    law.a = v[3];
    law.effective_modulus = v[4];
    law.k = v[5];
    law.n = (int)v[6];
    law.p = (int)v[7];
    return law;
}

int main(void)
{
    double head[25];
    while (fread(head, sizeof(double), 25, stdin) == 25) {
        const int kind = (int)head[0], steps = (int)head[1];
        const mcc_law law_i = law_of(head + 2), law_j = law_of(head + 13);
        const mcc_contact plates = mcc_plates(&law_i, head[10], head[11], head[12]);
        const mcc_contact i = mcc_half_contact(&law_i, head[10], head[11], head[12]);
        const mcc_contact j = mcc_half_contact(&law_j, head[21], head[22], head[23]);
        double x_max = head[24];
        int k;
        for (k = 0; k < steps; ++k) {
            double x, out[3];
            mcc_response r;
            if (fread(&x, sizeof x, 1, stdin) != 1) return EXIT_FAILURE;
            r = kind == 0 ? mcc_step(&plates, x_max, x) : mcc_pair_step(&i, kind == 1 ? NULL : &j, x_max, x);
            x_max = r.x_max;
            out[0] = r.force;
            out[1] = r.tangent;
            out[2] = r.x_max;
            if (fwrite(out, sizeof(double), 3, stdout) != 3) return EXIT_FAILURE;
        }
    }
    return EXIT_SUCCESS;
}
