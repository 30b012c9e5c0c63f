"""Linear attenuation coefficients (1/m) at 60 keV, the mean energy of the beam.

Mass attenuation coefficients, m²/kg, are those of the NIST tables (Hubbell and Seltzer,
NIST SRD 126): water 2.059e-2, polyamide 1.95e-2, iodine 0.758, BaSO4 0.512, stainless
steel 304 0.119, nickel-titanium 0.1176, platinum with 10 % iridium 0.432.

Vessel and device replace the same volume of water (tissue), so they count with their
*excess* over water: `mu - WATER`.
"""

# Water and soft tissue, 1/m: 2.059e-2 m²/kg x 1000 kg/m³.
WATER = 20.6

# Iodine in solution, m²/kg: excess attenuation is this times kg of iodine per m³.
IODINE = 0.758

# Iodine concentration in the lumen while contrast runs, kg/m³ (= mg/ml). An arterial
# CT angiogram with 350-400 HU in the aorta has about 15; undiluted agent has 300-370.
CONTRAST = 15.0

# Solid materials, 1/m: mass coefficient times density.
STEEL = 951.0  # 304, 8000 kg/m³
NITINOL = 759.0  # 6450 kg/m³
PLATINUM = 9310.0  # 90/10 platinum-iridium, 21550 kg/m³
# Polyamide (1100 kg/m³) with 40 % by weight of BaSO4 (4500 kg/m³), a usual filling of
# radio-opaque tubing (20-60 %): density 1576 kg/m³, 0.4 x 0.512 + 0.6 x 0.0195 m²/kg.
BARIUM_POLYMER = 341.0

# A 5F braided catheter (outer 1.67 mm, lumen 1.17 mm = 0.046 in): the polymer fills
# 0.49 of the cross-section and a braid of sixteen 0.025 x 0.1 mm steel wires 0.018.
# The rest of it counts as water (a saline-filled lumen).
CATHETER = 0.49 * (BARIUM_POLYMER - WATER) + 0.018 * (STEEL - WATER)

# Solid wires, and a platinum marker band 0.05 mm thick round a 5F tube: 4 x 0.05 / 1.67
# of the area, with the catheter wall under it.
STEEL_WIRE = STEEL - WATER
NITINOL_WIRE = NITINOL - WATER
MARKER = 0.116 * (PLATINUM - WATER) + 0.39 * (BARIUM_POLYMER - WATER)

# Length of a marker band, m: bands are sold in lengths of 1-2 mm.
MARKER_LENGTH = 2.0e-3
