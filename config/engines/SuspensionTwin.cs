// SPDX-License-Identifier: Apache-2.0
// Moves a car of Unity as the twin's: docs/engines.md.
using System;
using RosMessageTypes.Geometry;
using RosMessageTypes.Sensor;
using Unity.Robotics.ROSTCPConnector;
using UnityEngine;

public class SuspensionTwin : MonoBehaviour
{
    public Transform[] wheels = new Transform[4];
    public string prefix = "";                    // the namespace of the twin, such as "car_1/"
    readonly float[] rest = new float[4];         // local height of each wheel's centre at rest
    double[] standing;                            // compression at rest, m
    Vector3 place, placeBefore;                   // of the two newest poses
    Quaternion turn, turnBefore;
    double stamp, interval, arrived;              // s: of the newest, since the one before, on Unity's clock

    void Start()
    {
        for (int i = 0; i < wheels.Length; i++) rest[i] = wheels[i].localPosition.y;
        var ros = ROSConnection.GetOrCreateInstance();
        ros.Subscribe<PoseStampedMsg>(prefix + "twin/pose", OnPose);
        ros.Subscribe<JointStateMsg>(prefix + "joint_states", OnJoints);
    }

    void OnPose(PoseStampedMsg message)
    {
        var p = message.pose.position;
        var q = message.pose.orientation;
        double t = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec;
        placeBefore = place;
        turnBefore = turn;
        interval = t - stamp;
        stamp = t;
        arrived = Time.timeAsDouble;
        place = new Vector3((float)-p.y, (float)p.z, (float)p.x);
        turn = new Quaternion((float)q.y, (float)-q.z, (float)-q.x, (float)q.w);
    }

    void Update()
    {
        if (stamp == 0) return;
        // to the moment of this frame, with the speeds between the two newest poses, by 0.2 s at most
        float share = 1f;
        if (interval > 0 && interval < 0.2) share += (float)(Math.Min(Time.timeAsDouble - arrived, 0.2) / interval);
        transform.SetPositionAndRotation(
            Vector3.LerpUnclamped(placeBefore, place, share), Quaternion.SlerpUnclamped(turnBefore, turn, share));
    }

    void OnJoints(JointStateMsg message)
    {
        if (standing == null) standing = (double[])message.position.Clone();  // begin with a standing car
        for (int i = 0; i < wheels.Length; i++)
        {
            var local = wheels[i].localPosition;
            local.y = rest[i] + (float)(message.position[i] - standing[i]);  // compression moves the wheel up
            wheels[i].localPosition = local;
        }
    }
}
