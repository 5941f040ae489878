"""Mechanisms for a drawn curve: structure and dimensions of linkages, by growth, lanes and exact derivatives.

`mechanisms_for` is the public function. `targets` compares curves; `dyads` evaluates positions and derivatives of linkages, made
of the dyads of `dyad_forms`; `random_linkages` makes and grows them, `matching` finds those whose curves resemble the target,
`descent` improves them. `curve_search` combines these; `linkage_drawing` and `curve_designs` return results. `comparison` is the
distance of goals of `design`; `found_mechanism` is the common base of all results of `synthesis`.
"""
