"""x"""
import json
import numpy as np
import jax.numpy as jnp
from pathlib import Path

exp, cos, sin, pi = jnp.exp, jnp.cos, jnp.sin, jnp.pi

def misra1a(b, x): return b[0] * (1 - exp(-b[1] * x))
def misra1b(b, x): return b[0] * (1 - (1 + b[1] * x / 2) ** -2)
def misra1c(b, x): return b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5)
def misra1d(b, x): return b[0] * b[1] * x / (1 + b[1] * x)
def chwirut(b, x): return exp(-b[0] * x) / (b[1] + b[2] * x)
def lanczos(b, x): return b[0] * exp(-b[1] * x) + b[2] * exp(-b[3] * x) + b[4] * exp(-b[5] * x)
def gauss(b, x): return b[0] * exp(-b[1] * x) + b[2] * exp(-((x - b[3]) ** 2) / b[4] ** 2) + b[5] * exp(-((x - b[6]) ** 2) / b[7] ** 2)
def danwood(b, x): return b[0] * x ** b[1]
def kirby2(b, x): return (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2)
def hahn1(b, x): return (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)
def nelson(b, x1, x2): return b[0] - b[1] * x1 * exp(-b[2] * x2)
def mgh17(b, x): return b[0] + b[1] * exp(-x * b[3]) + b[2] * exp(-x * b[4])
def roszman1(b, x): return b[0] - b[1] * x - jnp.arctan(b[2] / (x - b[3])) / pi
def enso(b, x):
    return (b[0] + b[1] * cos(2 * pi * x / 12) + b[2] * sin(2 * pi * x / 12)
        + b[4] * cos(2 * pi * x / b[3]) + b[5] * sin(2 * pi * x / b[3])
        + b[7] * cos(2 * pi * x / b[6]) + b[8] * sin(2 * pi * x / b[6]))
def mgh09(b, x): return b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3])
def boxbod(b, x): return misra1a(b, x)
def rat42(b, x): return b[0] / (1 + exp(b[1] - b[2] * x))
def rat43(b, x): return b[0] / (1 + exp(b[1] - b[2] * x)) ** (1 / b[3])
def eckerle4(b, x): return b[0] / b[1] * exp(-0.5 * ((x - b[2]) / b[1]) ** 2)
def mgh10(b, x): return b[0] * exp(b[1] / (x + b[2]))
def bennett5(b, x): return b[0] * (b[1] + x) ** (-1 / b[2])

MODELS = dict(Misra1a=misra1a, Misra1b=misra1b, Misra1c=misra1c, Misra1d=misra1d, Chwirut1=chwirut, Chwirut2=chwirut,
 Lanczos1=lanczos, Lanczos2=lanczos, Lanczos3=lanczos, Gauss1=gauss, Gauss2=gauss, Gauss3=gauss, DanWood=danwood,
 Kirby2=kirby2, Hahn1=hahn1, Thurber=hahn1, Nelson=nelson, MGH17=mgh17, Roszman1=roszman1, ENSO=enso, MGH09=mgh09,
 BoxBOD=boxbod, Rat42=rat42, Rat43=rat43, Eckerle4=eckerle4, MGH10=mgh10, Bennett5=bennett5)
