// Renders recorded messages, as clients/c/tests/replay.c does: `Replay.exe RECORD FORCES`.
using System.IO;
using Palpate;

static class Replay
{
    static int Main(string[] arguments)
    {
        var options = TouchOptions.Default;
        options.Limits = Limits.Of("omega3");
        options.InTissueFrame = true;
        using (var record = new BinaryReader(File.OpenRead(arguments[0])))
        using (var forces = new BinaryWriter(File.Create(arguments[1])))
        using (var touch = Touch.Offline(options, new Vector(record.ReadDouble(), record.ReadDouble(), record.ReadDouble())))
        {
            long length = record.BaseStream.Length;
            while (record.BaseStream.Position < length)
            {
                if (record.ReadUInt32() == 0)
                {
                    touch.Arrive(record.ReadBytes((int)record.ReadUInt32()));
                    continue;
                }
                double time = record.ReadDouble();
                var place = new Vector(record.ReadDouble(), record.ReadDouble(), record.ReadDouble());
                var force = touch.Tick(new Reading(place, record.ReadDouble() != 0.0), time).Force;
                forces.Write(force.X);
                forces.Write(force.Y);
                forces.Write(force.Z);
            }
        }
        return 0;
    }
}
