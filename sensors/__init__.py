"""Sensors: records, time, rotations, geodesy, logs, datasets and simulation.

Conventions of the whole project
--------------------------------
Time        int64 nanoseconds, Unix UTC. ``t_ns`` is when a measurement was true, ``arrival_ns`` when it came in.
World       WGS-84. ``llh`` is (latitude rad, longitude rad, height above the ellipsoid m).
Local axes  ENU (east, north, up) at the vehicle. Map axes are those of the log's ``MapFrame`` (UTM or one ENU plane).
Body        FLU (forward, left, up), origin at the IMU's measurement centre. Extrinsics (``Vehicle``) are given in it.
Yaw         counter-clockwise from east (ENU) or from the map's x axis; clockwise headings never leave an importer.
Rotations   ``R_a_b`` takes vectors from b to a; ``p_a`` is expressed in a; ``q_a_b`` is xyzw, Hamilton, scalar last.
            Euler angles are roll, pitch, yaw about x, y, z: ``R_enu_body = Rz(yaw) Ry(pitch) Rx(roll)``.
            In FLU a positive pitch lowers the nose.
Errors      estimate minus reference; longitudinal along, lateral left of the reference heading.
Attitude    error on the left, in ENU: ``R_true = Exp(dtheta) R_estimate``.
Units       SI and radians; a suffix where not (``_deg``, ``_hz``, ``_ns``).
Covariance  of positions in ENU or map axes in m^2; of a pose fix in the order (x m, y m, yaw rad), map axes.
"""
