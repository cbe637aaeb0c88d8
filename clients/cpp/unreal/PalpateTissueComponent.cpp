// The tissue of a session in Unreal. Palpate's tests do not build it, because they have no Unreal.
#include "PalpateTissueComponent.h"

#include "HAL/PlatformProcess.h"
#include "HAL/RunnableThread.h"

UPalpateTissueComponent::UPalpateTissueComponent(const FObjectInitializer& Initializer) : Super(Initializer) {
    PrimaryComponentTick.bCanEverTick = true;
}

static void Tell(const palpate::Error& Error) { UE_LOG(LogTemp, Error, TEXT("Palpate: %s"), UTF8_TO_TCHAR(Error.words.c_str())); }

void UPalpateTissueComponent::BeginPlay() {
    Super::BeginPlay();
    auto Connected = palpate::Server::connect(TCHAR_TO_UTF8(*Url));
    if (!Connected) return Tell(Connected.error());
    Server = std::make_unique<palpate::Server>(std::move(*Connected));
    auto Made = Server->create(TCHAR_TO_UTF8(*Scene));
    if (!Made) return Tell(Made.error());
    Session = std::make_unique<palpate::Session>(std::move(*Made));
    palpate::SurfaceOptions Look;
    Look.axes = PALPATE_AXES_UNREAL;
    auto Seen = Session->surface(Look);
    if (!Seen) return Tell(Seen.error());
    Surface = std::make_unique<palpate::Surface>(std::move(*Seen));
    Surface->read();
    const int32 Count = int32(Surface->positions().size() / 3);
    Vertices.SetNumZeroed(Count);
    Normals.SetNumZeroed(Count);
    for (std::size_t k = 0; k + 1 < Surface->uv().size(); k += 2) Uv.Emplace(Surface->uv()[k], Surface->uv()[k + 1]);
    TArray<int32> Triangles;
    for (std::uint32_t Index : Surface->indices()) Triangles.Add(int32(Index));
    Show();
    CreateMeshSection(0, Vertices, Triangles, Normals, Uv, TArray<FColor>(), TArray<FProcMeshTangent>(), false);

    palpate::TouchOptions Options;
    Options.axes = PALPATE_AXES_UNREAL;
    Options.in_tissue_frame = 1;
    palpate_limits_of("omega3", &Options.limits);
    Options.limits.workspace_radius_m = 1.0;
    auto Tool = Session->touch(Options);
    if (!Tool) return Tell(Tool.error());
    Loop = std::make_unique<FLoop>(std::move(*Tool));
    Thread = FRunnableThread::Create(Loop.get(), TEXT("Palpate"), 0, TPri_TimeCritical);
}

void UPalpateTissueComponent::EndPlay(const EEndPlayReason::Type Reason) {
    if (Thread) {
        // Stops the loop and waits for its end.
        Thread->Kill(true);
        delete Thread;
        Thread = nullptr;
    }
    Loop.reset();
    Surface.reset();
    if (Session) Session->remove();
    Session.reset();
    Server.reset();
    Super::EndPlay(Reason);
}

void UPalpateTissueComponent::TickComponent(float Seconds, ELevelTick Type, FActorComponentTickFunction* Function) {
    Super::TickComponent(Seconds, Type, Function);
    // Never waits for the server.
    if (Surface && Surface->read().count > 0) {
        Show();
        UpdateMeshSection(0, Vertices, Normals, Uv, TArray<FColor>(), TArray<FProcMeshTangent>());
    }
}

void UPalpateTissueComponent::Show() {
    for (int32 k = 0; k < Vertices.Num(); k++) {
        const float* Place = &Surface->positions()[3 * k];
        const float* Normal = &Surface->normals()[3 * k];
        Vertices[k] = FVector(Place[0], Place[1], Place[2]);
        Normals[k] = FVector(Normal[0], Normal[1], Normal[2]);
    }
}

void UPalpateTissueComponent::SetTool(FVector Place, bool bEnable) {
    if (!Loop) return;
    FScopeLock Lock(&Loop->Exchange);
    Loop->Wanted = palpate::Reading{{Place.X, Place.Y, Place.Z}, bEnable ? 1u : 0u};
}

FVector UPalpateTissueComponent::GetForce() const {
    if (!Loop) return FVector::ZeroVector;
    FScopeLock Lock(&Loop->Exchange);
    return FVector(Loop->Felt.force_n.x, Loop->Felt.force_n.y, Loop->Felt.force_n.z);
}

uint32 UPalpateTissueComponent::FLoop::Run() {
    const double Begin = FPlatformTime::Seconds();
    palpate::Reading At{};
    for (int64 Tick = 1; !bOver; Tick++) {
        palpate::Reading To;
        {
            FScopeLock Lock(&Exchange);
            To = Wanted;
        }
        // The game moves the tool sixty times a second, in jumps; a hand does not. So its movement is smoothed. With
        // a haptic device, read its position here instead.
        const double Share = 0.02;
        At.position.x += Share * (To.position.x - At.position.x);
        At.position.y += Share * (To.position.y - At.position.y);
        At.position.z += Share * (To.position.z - At.position.z);
        At.enable = To.enable;
        const palpate::Felt Now = Touch.tick(At, FPlatformTime::Seconds());
        {
            FScopeLock Lock(&Exchange);
            Felt = Now;
        }
        while (FPlatformTime::Seconds() < Begin + 1e-3 * Tick) FPlatformProcess::SleepNoStats(0.0f);
    }
    return 0;
}
