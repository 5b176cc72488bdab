/* Functions of complex numbers that Wine's C library lacks, as Microsoft's compiler calls them: with structs of two
   numbers, and with a long double that is a double. The work is done by MinGW's own library. */

#include <complex.h>

typedef struct { double re, im; } Double;
typedef struct { float re, im; } Float;

#define DOUBLE(name) \
    Double wine_##name(Double z) { \
        double _Complex w = name(__builtin_complex(z.re, z.im)); \
        return (Double){creal(w), cimag(w)}; \
    }
#define FLOAT(name) \
    Float wine_##name##f(Float z) { \
        float _Complex w = name##f(__builtin_complex(z.re, z.im)); \
        return (Float){crealf(w), cimagf(w)}; \
    }
#define BOTH(name) DOUBLE(name) FLOAT(name)

BOTH(cacos) BOTH(cacosh) BOTH(casin) BOTH(casinh) BOTH(catan) BOTH(catanh) BOTH(ccos) BOTH(ccosh) BOTH(cexp) BOTH(clog)
BOTH(csin) BOTH(csinh) BOTH(csqrt) BOTH(ctan) BOTH(ctanh)

double wine_cabs(Double z) { return cabs(__builtin_complex(z.re, z.im)); }
float wine_cabsf(Float z) { return cabsf(__builtin_complex(z.re, z.im)); }
double wine_carg(Double z) { return carg(__builtin_complex(z.re, z.im)); }
float wine_cargf(Float z) { return cargf(__builtin_complex(z.re, z.im)); }

Double wine_cpow(Double z, Double to) {
    double _Complex w = cpow(__builtin_complex(z.re, z.im), __builtin_complex(to.re, to.im));
    return (Double){creal(w), cimag(w)};
}
Float wine_cpowf(Float z, Float to) {
    float _Complex w = cpowf(__builtin_complex(z.re, z.im), __builtin_complex(to.re, to.im));
    return (Float){crealf(w), cimagf(w)};
}
