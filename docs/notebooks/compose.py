# %% [markdown]
# # compose
# %%
print(1)
