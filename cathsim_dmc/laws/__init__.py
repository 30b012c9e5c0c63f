"""The physics of devices in vessels, without an engine.

One file is one law: a pure function of named parameters, time and arrays. A law
allocates nothing (scratch is passed in), uses no engine and no global state, and works
in float64 and SI units. `compiled.law` and `compiled.inlined` compile it for the CPU,
and `compiled.for_cuda` gives the same function, and all that it calls, to kernels of
numba-cuda; laws therefore import functions by name, not modules. Parameters are
NamedTuples, which numba passes at the cost of plain arguments. No field is called
`index` or `count`: on CUDA the tuple's method of that name hides the field.

    vectors          products of vectors, frames
    field            signed depth in a lumen, on sparse bricks: `FieldArrays`
    bore             clearance in a round bore around a polyline
    wall             clearance and normal of a field or a bore: `Wall`
    places           `Capsule` and `Places`
    capsule          places along a capsule that are nearest to a wall
    planes           tangent planes of the wall at such a place
    contact          contacts of a capsule with a wall at rest
    heart            inflow and pulse over a beat
    motion           how heart and breathing displace space: `MotionParameters`
    moving_contact   contacts of a capsule with a wall that moves
    blood            drag on the links of a device
    springs, hinges  springs of devices with a shape
    compliance       contact with a compliant wall
    drive            servos that slip
    sheath           hinges of the links in a sheath
    coaxial          overlap of coaxial devices, and the chain that represents them
    coaxial_forces   forces between coaxial devices
    torsion          twist of coaxial devices
    sliding          coaxial devices in a control step
    device           state that the laws of effects read
    parameters       how the parameters of an effect's law are declared

An engine's adapter does five things for each pair of a link and a wall
(`collision/loops.py` is MuJoCo's):

1. `wall.Wall`: `anatomy.field.Field.arrays` of a lumen, with any float64 array as
   `line`; or the array of a bore as `line`, with any `FieldArrays`.
2. `places.Capsule`: the link in the frame of the wall, and which of its end caps
   collide (`contact.end_caps`).
3. `contact.contact_law` gives the `Law` of the pair, and `contact.sweep_of` the `Sweep`
   of the link from its displacement and rotation in a physics step.
4. `contact.contacts`, or `moving_contact.moving_contacts`, writes at most `planes.MOST`
   rows of `contact.CONTACT` numbers and returns how many: unit normal (3), clearance,
   place along the axis, and whether the contact shares its spring with another one of
   that place.
5. `contact.world_contact` turns a row into the distance, the point and the direction of
   a contact in the world.
"""
