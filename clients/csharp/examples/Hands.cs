// Two hands with a grasper each: `Hands.exe URL SCENE SECONDS`. Devices of six axes in simulated hands press the tissue and
// close the jaws in it, each on a thread of the library. Ends when both have felt the tissue twice, or after SECONDS. Prints
// one line of JSON.
using System;
using System.Globalization;
using System.Threading;
using Palpate;

/// A simulated hand and its device. Replace this with the calls of your device's SDK.
class Grasper : IInstrumentDevice
{
    readonly Orientation orientation;
    readonly double x;
    Vector place, force;
    long ticks;
    public double MostForce, MostTorque;
    public Grasper(Orientation orientation, double x) { this.orientation = orientation; this.x = x; place = new Vector(x, 0.0, 0.006); }
    public Limits Limits { get { return Limits.Of("sigma7"); } }
    /// The hand leads the device by a spring of 300 N/m and a damping of 5.5 N·s/m.
    static double Moved(double from, double goal, double force) { return from + 1e-3 * (300.0 * (goal - from) + force) / 5.5; }
    public InstrumentReading Read()
    {
        // From 6 mm above the tissue down to 3 mm below, and up, in 2 s; open above, closed in it.
        double part = Math.Cos(Math.PI * ticks++ / 1000.0);
        place = new Vector(Moved(place.X, x, force.X), Moved(place.Y, 0.0, force.Y), Moved(place.Z, 0.0015 + 0.0045 * part, force.Z));
        return new InstrumentReading(place, orientation, 0.3 + 0.25 * part, ticks % 500 < 250);
    }
    public void Write(Vector force, Vector torque)
    {
        this.force = force;
        MostForce = Math.Max(MostForce, force.Length);
        MostTorque = Math.Max(MostTorque, torque.Length);
    }
    public double Force { get { return force.Length; } }
}

static class Hands
{
    static string Numbers(string format, double left, double right)
    {
        return "[" + left.ToString(format, CultureInfo.InvariantCulture) + "," + right.ToString(format, CultureInfo.InvariantCulture) + "]";
    }

    static int Main(string[] arguments)
    {
        double seconds = double.Parse(arguments[2], CultureInfo.InvariantCulture);
        double cos = Math.Cos(Math.PI / 36.0), sin = Math.Sin(Math.PI / 36.0);
        // 10° downwards; the left one towards x, the right one, turned by 180° about z, towards it.
        var graspers = new[] { new Grasper(new Orientation(cos, 0, sin, 0), -0.006), new Grasper(new Orientation(0, -sin, 0, cos), 0.006) };
        var options = TouchOptions.Default;
        options.Jaws = 0.015;
        options.Shaft = 0.02;
        options.TipRadius = 0.003;
        options.MaxTorque = 0.4;
        uint tools = options.ToolCount;
        var hands = Hand.Two();
        using (var server = new Server(arguments[0]))
        using (var session = server.Create(arguments[1]))
        using (var left = session.Bridge(graspers[0], options, hands[0]))
        {
            options.Tool = tools;
            using (var right = session.Bridge(graspers[1], options, hands[1]))
            {
                var bridges = new[] { left, right };
                var felt = new int[2];
                for (int look = 0; look < 10 * seconds && (felt[0] < 2 || felt[1] < 2); look++)
                {
                    for (int hand = 0; hand < 2; hand++)
                    {
                        var state = bridges[hand].LookInstrument();
                        if (state.Force.Length > 0.05) felt[hand]++;
                    }
                    Thread.Sleep(100);
                }
                left.End();
                right.End();
            }
            Console.WriteLine("{\"tools\":" + tools + ",\"force_max_n\":" + Numbers("F4", graspers[0].MostForce, graspers[1].MostForce)
                + ",\"torque_max_n_m\":" + Numbers("F5", graspers[0].MostTorque, graspers[1].MostTorque)
                + ",\"force_at_end_n\":" + Numbers("F4", graspers[0].Force, graspers[1].Force) + "}");
            session.Delete();
        }
        foreach (var hand in hands) hand.Dispose();
        return 0;
    }
}
