"""A head that is equivariant to mirroring: f(mirror x) = mirror f(x), by weights that are equal to their own mirror images.

Channels of hidden layers come in pairs that change places under the mirror; folded pixels change columns. The weights start in
this subspace and their gradients are projected onto it, and Adam treats equal gradients alike, so they stay in it.
"""

import torch
from sundae_ns.compensation.head import CompensationHead


def pairs(n):
    return (torch.arange(n) + n // 2) % n


def folded(n, fold):
    i = torch.arange(n * fold * fold)
    c, dy, dx = i // (fold * fold), i // fold % fold, i % fold
    return c * fold * fold + dy * fold + (fold - 1 - dx)


def orders(net):
    """(parameter, permutation of outputs, of inputs or None) for all layers."""
    fold, found = net.pixel_unshuffle, []
    for number, block in enumerate([*net.encoder, *net.decoder]):
        convs = [block[0], block[2]]
        for place, conv in enumerate(convs):
            c_in = conv.in_channels
            if number == 0 and place == 0:
                order = folded(c_in // fold**2, fold)
            elif number >= len(net.encoder) and place == 0:  # coarse, then skip
                skip = conv.out_channels
                order = torch.cat([pairs(c_in - skip), c_in - skip + pairs(skip)])
            else:
                order = pairs(c_in)
            found += [(conv.weight, pairs(conv.out_channels), order), (conv.bias, pairs(conv.out_channels), None)]
    o = folded(3, fold)
    return found + [(net.out.weight, o, pairs(net.out.in_channels)), (net.out.bias, o, None)]


def mirrored(value, out, into):
    value = value[out]
    return value if into is None else value[:, into].flip(3)


def tie(net):
    for value, out, into in orders(net):
        with torch.no_grad():
            value.copy_((value + mirrored(value, out, into)) * (0.5 if value.ndim == 1 else 0.5**0.5))
        places = {}

        def project(g, out=out, into=into, places=places):
            if g.device not in places:  # the first step runs kernel by kernel
                places[g.device] = out.to(g.device), None if into is None else into.to(g.device)
            total = (g + mirrored(g, *places[g.device])) / 2
            return total.contiguous(memory_format=torch.channels_last if g.ndim == 4 else torch.contiguous_format)

        value.register_hook(project)


def error(net):
    return max(
        float(
            (v - mirrored(v, o.to(v.device), None if i is None else i.to(v.device))).abs().max()
            / v.abs().max().clamp_min(1e-9)
        )
        for v, o, i in orders(net)
    )


def install():
    build = CompensationHead._build

    def tied(self, config):
        build(self, config)
        tie(self.net)

    CompensationHead._build = tied
