// The tissue of a session in Unreal. Palpate's tests do not build it, because they have no Unreal.
#pragma once

#include "CoreMinimal.h"
#include "HAL/Runnable.h"
#include "HAL/ThreadSafeBool.h"
#include "ProceduralMeshComponent.h"

#include <memory>
#include <palpate.hpp>

#include "PalpateTissueComponent.generated.h"

/// Shows the surface of a session, and moves a tool in it.
UCLASS(ClassGroup = (Palpate), meta = (BlueprintSpawnableComponent))
class UPalpateTissueComponent : public UProceduralMeshComponent {
    GENERATED_BODY()

public:
    UPalpateTissueComponent(const FObjectInitializer& Initializer);

    UPROPERTY(EditAnywhere, Category = Palpate)
    FString Url = TEXT("http://127.0.0.1:7117");

    UPROPERTY(EditAnywhere, Category = Palpate)
    FString Scene = TEXT("liver");

    /// Sets the target position of the tool, in this component's frame, cm. Forces are rendered when `bEnable`
    /// becomes true.
    UFUNCTION(BlueprintCallable, Category = Palpate)
    void SetTool(FVector Place, bool bEnable);

    /// Returns the force on the tool, N.
    UFUNCTION(BlueprintCallable, Category = Palpate)
    FVector GetForce() const;

    void BeginPlay() override;
    void EndPlay(const EEndPlayReason::Type Reason) override;
    void TickComponent(float Seconds, ELevelTick Type, FActorComponentTickFunction* Function) override;

private:
    /// The loop at 1 kHz.
    struct FLoop : FRunnable {
        explicit FLoop(palpate::Touch Tool) : Touch(std::move(Tool)) {}
        uint32 Run() override;
        void Stop() override { bOver = true; }

        palpate::Touch Touch;
        FThreadSafeBool bOver = false;
        mutable FCriticalSection Exchange;
        palpate::Reading Wanted{};
        palpate::Felt Felt{};
    };

    void Show();

    // Freed in reverse order.
    std::unique_ptr<palpate::Server> Server;
    std::unique_ptr<palpate::Session> Session;
    std::unique_ptr<palpate::Surface> Surface;
    std::unique_ptr<FLoop> Loop;
    FRunnableThread* Thread = nullptr;
    TArray<FVector> Vertices, Normals;
    TArray<FVector2D> Uv;
};
