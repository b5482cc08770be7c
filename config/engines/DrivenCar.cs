// SPDX-License-Identifier: Apache-2.0
// Drives the exported class CarSuspension in Unity: docs/export.md.
using UnityEngine;

public class DrivenCar : MonoBehaviour
{
    public Transform[] wheels = new Transform[4];  // front left, front right, rear left, rear right
    readonly CarSuspension car = new CarSuspension();
    Vector3 lastPosition, lastVelocity;

    void Start()
    {
        lastPosition = transform.position;
    }

    void FixedUpdate()
    {
        for (int c = 0; c < 4; c++)
            if (Physics.Raycast(wheels[c].position + Vector3.up, Vector3.down, out RaycastHit hit))
                car.RoadHeight[c] = hit.point.y;
        Vector3 velocity = (transform.position - lastPosition) / Time.fixedDeltaTime;
        Vector3 a = transform.InverseTransformDirection((velocity - lastVelocity) / Time.fixedDeltaTime);
        car.LongitudinalAcceleration = a.z;
        car.LateralAcceleration = -a.x;            // Unity's x is to the right
        lastVelocity = velocity;
        lastPosition = transform.position;
        car.Step(Time.fixedDeltaTime);             // car.Z, car.Roll, car.Pitch, car.Deflection(c), car.TyreForce(c)
    }
}
