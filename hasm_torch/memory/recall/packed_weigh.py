"""The pass of the packed scan that turns counts of rows at each distance into weights.

The compiled scan is cached by the time stamp of packed_kernel.py: touch that file after a change
here.
"""

import math

from numba import njit

FAR = 1 << 29  # distance of a row that takes no part

_SHARPEST = 1e4  # β beyond which only the nearest rows weigh, in float64
# What the passes know an interaction by; a degree d is -1 - d.
EXPONENTIAL, SOFTMAX, SPARSEMAX, ENTMAX15 = -1, 0, 1, 2
KINDS = {
    "exponential": EXPONENTIAL,
    "softmax": SOFTMAX,
    "sparsemax": SPARSEMAX,
    "entmax15": ENTMAX15,
}


@njit(nogil=True, cache=True)
def weigh(job):
    """Makes of the counts the weight of a row at each distance, and says how sure the recall is."""
    dim = job.table.shape[1] - 1
    for query in range(len(job.signs)):
        found, counts, table = job.found[0, query], job.counts[0, query], job.table[query]
        for part in range(1, len(job.found)):
            _merge(found, job.found[part, query])
            for distance in range(dim + 1):
                counts[distance] += job.counts[part, query, distance]
        least = found[0]
        if least == FAR:
            if len(job.match) > 0:
                job.match[query] = -1
                for number in range(3):
                    job.certainty[number, query] = math.nan
            if len(job.weights) > 0 and job.kind >= SOFTMAX:
                for row in range(job.weights.shape[1]):
                    job.weights[query, row] = math.nan
            continue
        last, taking_part = least, counts[least]
        while last < min(least + job.slack, dim) and not 0 < job.top_k <= taking_part:
            last += 1
            taking_part += counts[last]
        _fill(table, counts, least, last, job.beta, job.kind)
        job.last[query] = last
        if len(job.match) > 0:
            entropy = 0.0
            for distance in range(least, last + 1):
                if counts[distance] > 0 and table[distance] > 0:
                    entropy -= counts[distance] * table[distance] * math.log(table[distance])
            job.match[query] = found[2]
            job.certainty[0, query] = (dim - 2 * least) * (-1 if job.beta < 0 else 1)
            job.certainty[1, query] = 2 * (found[1] - least) if found[1] < FAR else math.inf
            job.certainty[2, query] = entropy


@njit(nogil=True, cache=True)
def _merge(found, other):
    """What two parts have found together; the first part lies before the other."""
    if other[0] < found[0]:
        found[0], found[1], found[2] = other[0], min(found[0], other[1]), other[2]
    else:
        found[1] = min(found[1], other[0])


@njit(nogil=True, cache=True)
def _fill(table, counts, least, last, beta, kind):
    """Weights, as in ``interaction``, of a row at the distances least to last where any lie."""
    sharpness, power = min(abs(beta), _SHARPEST), max(kind, 1)
    threshold = _threshold(counts, least, last, sharpness, power) if kind > SOFTMAX else 0.0
    weighed = 0.0
    for distance in range(least, last + 1):
        if counts[distance] == 0:
            continue
        x = -2.0 * sharpness * (distance - least) / power
        z = abs(beta) * (len(table) - 1 - 2 * distance)
        if kind == SOFTMAX:
            weight = math.exp(x)
        elif kind > SOFTMAX:
            weight = max(x - threshold, 0.0) ** power
        elif kind == EXPONENTIAL:
            weight = math.exp(z)
        else:
            weight = z ** (EXPONENTIAL - kind)
        table[distance] = weight
        weighed += counts[distance] * weight
    if kind >= SOFTMAX:
        for distance in range(least, last + 1):
            table[distance] /= weighed


@njit(nogil=True, cache=True)
def _threshold(counts, least, last, sharpness, power):
    """τ of sparsemax or entmax15."""
    rows, total, squares, threshold = 0, 0.0, 0.0, 0.0
    for distance in range(least, last + 1):
        if counts[distance] == 0:
            continue
        x = -2.0 * sharpness * (distance - least) / power
        rows += counts[distance]
        total += counts[distance] * x
        squares += counts[distance] * x * x
        mean = total / rows
        spread = squares - rows * mean * mean
        farther = mean - 1.0 / rows
        if power == ENTMAX15:
            farther = mean - math.sqrt(max((1.0 - spread) / rows, 0.0))
        if x <= farther:  # these rows lie below the threshold that they would make
            break
        threshold = farther
    return threshold
